// Fast DDS writers under ROS 2 names, set up as rmw_fastrtps of ROS 2 Humble is: no type object.
//
//   fastdds_robot DOMAIN ADDRESS LEASE_S
//
// It uses the interface with that address only, and finds others without multicast. Orders come on
// standard input: one letter, then three strings, each after its length (u32): topic, type, bytes.
//   A  advertise; bytes is "latched" or empty       W  withdraw
//   P  publish bytes (CDR with its header)          M  is there a reader?
// All but P are answered by a line, "1" for yes. The end of its input is a crash: nobody is told.
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <iostream>
#include <map>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

using namespace eprosima::fastdds::dds;
using namespace eprosima::fastrtps::rtps;

static const uint32_t LONGEST = 16 << 20;

class Cdr : public TopicDataType {
 public:
  explicit Cdr(const std::string& name) {
    setName(name.c_str());
    m_typeSize = LONGEST;
    m_isGetKeyDefined = false;
    auto_fill_type_information(false);
    auto_fill_type_object(false);
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    const auto& message = *static_cast<std::string*>(data);
    std::memcpy(payload->data, message.data(), message.size());
    payload->length = static_cast<uint32_t>(message.size());
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(SerializedPayload_t*, void*) override { return false; }
  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<uint32_t>(static_cast<std::string*>(data)->size()); };
  }
  void* createData() override { return new std::string(); }
  void deleteData(void* data) override { delete static_cast<std::string*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

static std::string read_string() {
  uint32_t size = 0;
  std::cin.read(reinterpret_cast<char*>(&size), sizeof size);
  std::string text(size, '\0');
  std::cin.read(&text[0], size);
  if (!std::cin) _exit(0);
  return text;
}

static DomainParticipant* join(uint32_t domain, const std::string& address, int lease_s) {
  DomainParticipantQos qos;
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  udp->interfaceWhiteList.push_back(address);
  udp->sendBufferSize = 4 << 20;
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(udp);
  auto& builtin = qos.wire_protocol().builtin;
  for (const auto& peer : {address, std::string(getenv("PEER") ? getenv("PEER") : address)}) {
    Locator_t locator;
    IPLocator::setIPv4(locator, peer);
    builtin.initialPeersList.push_back(locator);
  }
  builtin.discovery_config.leaseDuration = eprosima::fastrtps::Duration_t(lease_s, 0);
  builtin.discovery_config.leaseDuration_announcementperiod = eprosima::fastrtps::Duration_t(1, 0);
  return DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

int main(int count, char** words) {
  if (count < 4) return 2;
  std::ios::sync_with_stdio(false);
  auto* participant = join(static_cast<uint32_t>(std::stoi(words[1])), words[2], std::stoi(words[3]));
  if (participant == nullptr) return 3;
  auto* publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
  std::map<std::string, std::pair<Topic*, DataWriter*>> open;
  char order = 0;
  while (std::cin.read(&order, 1)) {
    const std::string name = read_string(), type = read_string();
    std::string bytes = read_string();
    auto found = open.find(name);
    if (order == 'P') {
      found->second.second->write(&bytes);
      continue;
    }
    bool answer = true;
    if (order == 'A') {
      TypeSupport(new Cdr(type)).register_type(participant);
      auto* topic = participant->create_topic(name, type, TOPIC_QOS_DEFAULT);
      DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
      qos.endpoint().history_memory_policy = DYNAMIC_RESERVE_MEMORY_MODE;
      qos.data_sharing().off();
      qos.history().kind = KEEP_LAST_HISTORY_QOS;
      qos.history().depth = 10;
      qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
      qos.durability().kind =
          bytes == "latched" ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
      auto* writer = publisher->create_datawriter(topic, qos);
      answer = writer != nullptr;
      open[name] = {topic, writer};
    } else if (order == 'W') {
      publisher->delete_datawriter(found->second.second);
      participant->delete_topic(found->second.first);
      open.erase(found);
    } else {
      PublicationMatchedStatus status;
      found->second.second->get_publication_matched_status(status);
      answer = status.current_count > 0;
    }
    std::cout << (answer ? "1" : "0") << std::endl;
  }
  _exit(0);
}
